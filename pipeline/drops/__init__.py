"""Physics of water drops on glass: shape, refraction, image-space painter, ray-traced scenes."""
