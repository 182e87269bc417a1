"""Entry point of `python -m plumbline`."""

import sys

if __name__ == "__main__":  # worker processes import this module again
    try:
        from plumbline.cli.main import main
    except KeyboardInterrupt:  # the imports take a second
        sys.exit(130)
    main(prog_name="python -m plumbline")
