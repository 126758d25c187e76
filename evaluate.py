"""Evaluate a checkpoint: errors, closed-loop safety, report."""

from hno.cli.evaluate import main

if __name__ == "__main__":
    main()
