"""Evaluation as Evolution: adversarial traffic from a diffusion prior as a curriculum for driving policies."""
