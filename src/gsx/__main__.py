"""`python -m gsx`."""

import os
import sys
from contextlib import suppress

if __name__ == "__main__":
    with suppress(OSError):  # the current folder may be gone
        if sys.path[:1] == [os.getcwd()] and not sys.flags.safe_path:  # put there by -m: no code of ours lies there
            del sys.path[0]
    from gsx.cli.dispatch import main

    raise SystemExit(main())
