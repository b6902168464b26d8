"""e2, the adversary: topology, feasibility, skeleton, anchoring, potentials, guided
control."""
