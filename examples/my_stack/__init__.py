"""One worked extension for each extension point of e2rl, as an outside package would
have them."""
