"""Simulated worlds, and the faces that make a world look like hardware."""
