"""The referee: learned 2D translation against the radiometric render of the same poses, in kelvin."""
