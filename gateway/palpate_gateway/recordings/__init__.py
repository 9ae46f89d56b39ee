"""Files that play as devices."""
