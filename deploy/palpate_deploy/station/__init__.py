"""The processes of one lab PC: their profile, and how they are started and kept running."""
