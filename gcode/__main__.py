"""`python -m gcode` is the command `gcode`."""

from gcode.cli import main

if __name__ == "__main__":
    main()
