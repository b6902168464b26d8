"""What is likely: the frozen reverse-time SDE prior over joint traffic futures."""
