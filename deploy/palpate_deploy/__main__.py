"""``python -m palpate_deploy`` is ``palpate``."""

from palpate_deploy.cli import main

if __name__ == "__main__":
    main()
