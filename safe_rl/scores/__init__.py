"""The protocol: published scores, slates, normalisation, intervals."""
