"""Background traffic to compare with, on the synthesizer's interface."""
