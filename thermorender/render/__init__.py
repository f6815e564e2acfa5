"""From a scene and a pose to radiance: baked surfaces, light, heat, tracing, and the reference engine."""
