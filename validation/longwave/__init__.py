"""The sky's long-wave irradiance, as modelled from the weather near the ground and as the camera's sky, measured."""
