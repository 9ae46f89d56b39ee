"""``palpate demo``, and the bundles that come with palpate."""
