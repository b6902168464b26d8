"""How often an ego fails in traffic as the prior has it: the tail of the prior, drawn
from and measured (docs/guide/rate.md)."""
