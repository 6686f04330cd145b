"""The Safety Gym family: configurations, the benchmark suite and the batched environment."""
