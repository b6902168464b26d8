"""How it moves: dynamics, geometry, observation, reward, environment."""
