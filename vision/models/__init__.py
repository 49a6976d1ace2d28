"""The equations of the paper, and the fits to them."""
