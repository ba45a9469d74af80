"""The pure core: no clock, no I/O, no randomness, no logging. Same arguments, same bits."""
