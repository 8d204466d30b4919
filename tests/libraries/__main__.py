"""``python -m tests.libraries``."""

from tests.libraries import main

if __name__ == "__main__":
    main()
