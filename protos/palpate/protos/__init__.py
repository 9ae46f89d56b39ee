"""The language of the rooms: messages, topics, codec, session, bundle and record contracts."""
