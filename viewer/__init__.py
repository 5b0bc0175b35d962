"""The window: open a picture, zoom into its Gaussians, inspect and export them."""
