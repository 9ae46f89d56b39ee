"""Files that palpate writes and reads: records, tapes and model bundles."""
