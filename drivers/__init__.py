"""The hardware edge: drivers, and the facts and commands that cross it. Knows nothing of flight control."""
