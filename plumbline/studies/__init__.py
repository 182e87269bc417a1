"""Studies: one scenario over ranges of parameters or long times."""
