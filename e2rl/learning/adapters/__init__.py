"""The environment by the interfaces of other libraries: gymnasium, Stable-Baselines3."""
