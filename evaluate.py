"""Evaluate a checkpoint: errors, closed-loop safety, report."""

import sys

from hno.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]], "python evaluate.py"))
