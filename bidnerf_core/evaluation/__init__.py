"""How localizers are judged: protocols, pose errors, statistics, figures."""
