"""From frames back to the scene: a map of temperatures with its uncertainty, poses, and the camera's errors."""
