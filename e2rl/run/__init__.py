"""What every room shares: errors, configuration, files, processes, and the run itself."""
