"""The commands of ``palpate``: their options and help texts."""


def main() -> None:
    """Entry point of ``palpate``."""
    from palpate_deploy.cli.app import app

    app(prog_name="palpate")
