"""What a situation is: recordings, scenes, lane graphs and their sources."""
