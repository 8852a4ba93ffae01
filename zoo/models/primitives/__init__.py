"""Movement primitives in channels, components and autoencoders."""
