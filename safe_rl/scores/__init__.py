"""Statistics of the benchmark's protocol: published scores, normalisation, intervals, tests."""
