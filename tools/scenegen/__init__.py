"""Build-time generator of the bundled scenes: parametric layouts -> netconvert -> SUMO
-> smooth tracks -> assets."""
