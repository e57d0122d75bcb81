"""Command line: one module per group of commands, and common options."""
