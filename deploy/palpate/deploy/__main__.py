"""``python -m palpate.deploy`` is ``palpate``."""

from palpate.deploy.cli import main

if __name__ == "__main__":
    main()
