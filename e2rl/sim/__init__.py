"""Simulator: dynamics, observation, reward and the environment."""
