"""Evaluation of localizers: protocols, pose errors, statistics, figures."""
