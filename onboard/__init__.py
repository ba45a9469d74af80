"""The flight process: the pure core, and the loop, clock, recorder and configuration around it."""
