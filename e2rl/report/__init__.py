"""Reports: tables, figures and replays."""
