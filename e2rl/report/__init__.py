"""How we show it: tables, figures and replays."""
