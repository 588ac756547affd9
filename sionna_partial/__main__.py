"""`python -m sionna_partial` is the command line."""

from sionna_partial.cli.app import main

if __name__ == "__main__":
    main()
