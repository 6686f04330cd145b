"""The protocol: published scores, slates, normalisation, dominance, intervals."""
