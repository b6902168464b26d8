"""Egos: planners and the learned actor behind one interface."""
