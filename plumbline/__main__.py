"""Entry point of `python -m plumbline`."""

from plumbline.cli.main import main

if __name__ == "__main__":  # worker processes import this module again
    main(prog_name="python -m plumbline")
