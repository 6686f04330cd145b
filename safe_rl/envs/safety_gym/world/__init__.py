"""Building worlds, starting episodes in them, and taking and setting their state."""
