"""Encode and decode of an electrode frame with checks; the same as ``palpate bench codec``."""

from palpate_deploy.cli.app import app

if __name__ == "__main__":
    app(["bench", "codec"])
