"""What a configuration means: one table each of elements, tasks, costs, readings and robots."""
