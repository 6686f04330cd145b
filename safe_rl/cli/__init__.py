"""What a person types: training, evaluations, reports, and the same from Python."""
