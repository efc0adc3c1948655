"""The command line as `python -m pisigma`."""

from pisigma.cli.main import run

if __name__ == "__main__":
    run()
