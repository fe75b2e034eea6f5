"""`python -m gsx`."""

from gsx.cli.dispatch import main

if __name__ == "__main__":
    raise SystemExit(main())
