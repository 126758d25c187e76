"""`python -m hno`."""

import sys

from hno.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
