"""Random views of images, on any device."""
