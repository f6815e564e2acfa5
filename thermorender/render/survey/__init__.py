"""What a survey sees of a scene's surfaces: daylight on their texels, and the view straight down."""
