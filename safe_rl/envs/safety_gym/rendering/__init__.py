"""Pictures of the worlds: for people, for videos, and as what a robot sees."""
