"""Causal templates of an attack: who may act on the ego directly, and who from afar through others.

`single`: one vehicle acts on the ego; `pair`: two do; `chain`: one does, and one more acts on it from afar, through
others where need be; `full`: as many as the traffic method is set to. Tensors hold them as codes, the places in
TEMPLATES.
"""

TEMPLATES = ("single", "pair", "chain", "full")
SINGLE, PAIR, CHAIN, FULL = range(len(TEMPLATES))
