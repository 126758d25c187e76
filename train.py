"""Train a value operator: build from the config, fit, evaluate, write results."""

import sys

from hno.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]], "python train.py"))
