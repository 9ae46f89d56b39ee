"""The tables: every system on every split, kept cell by cell, and the page that shows them."""
