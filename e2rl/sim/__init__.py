"""How it moves: dynamics, observation, reward, environment."""
