"""Could the ego have avoided the collision? A search that knows how everybody else moves.

A room of its own because evaluation and learning both use it, and because no ego may use what this search knows.
"""
