"""`python -m symplearn` is the `symplearn` command."""

from .cli import main

if __name__ == "__main__":
    main()
