"""Could the ego have avoided it: a search with full knowledge of the others' motion. Needs scene, sim and ego's paths.

A room of its own because evaluation and learning both ask, and because no ego may know what this search knows.
"""
