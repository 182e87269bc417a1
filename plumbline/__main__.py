"""Entry point of `python -m plumbline`."""

import sys


def start(name: str = "plumbline") -> None:
    """Run the command line.

    Args:
        name: how the user called it.

    """
    try:
        from plumbline.cli.main import main
    except KeyboardInterrupt:  # the imports take a second
        sys.exit(130)
    main(prog_name=name)


if __name__ == "__main__":  # worker processes import this module again
    start("python -m plumbline")
