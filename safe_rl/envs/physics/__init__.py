"""MuJoCo, a batch of worlds at a time."""
