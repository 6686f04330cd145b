"""The protocol: reference scores, slates, normalisation, intervals."""
