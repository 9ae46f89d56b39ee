"""``palpate fem`` and its commands."""
