"""Train a value operator: build from the config, fit, evaluate, write results."""

from hno.cli.train import main

if __name__ == "__main__":
    main()
