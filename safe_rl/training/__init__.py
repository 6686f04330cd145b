"""The loop: collect, account, learn, record."""
