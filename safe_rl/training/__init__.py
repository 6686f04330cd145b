"""The training loop: collect a batch, compute episode statistics, learn, record."""
