"""What a person types: commands, shorthands, checks of names and values."""
