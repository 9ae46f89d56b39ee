"""Looking at a station and its files: status, doctor, topics, records, replay."""
