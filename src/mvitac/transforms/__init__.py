"""Random views of images, and flips of gel images."""
