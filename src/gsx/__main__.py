"""`python -m gsx`."""

import os
import sys

if __name__ == "__main__":
    if sys.path[:1] == [os.getcwd()] and not sys.flags.safe_path:  # put there by -m: what lies there is no code of ours
        del sys.path[0]
    from gsx.cli.dispatch import main

    raise SystemExit(main())
