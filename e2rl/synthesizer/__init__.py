"""What is dangerous: topology, feasibility, skeleton, anchoring, potentials, guided control."""
