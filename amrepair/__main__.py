"""`python -m amrepair` is the command `amrepair`."""

from amrepair.cli import main

if __name__ == "__main__":
    main()
