"""The referee: compares learned 2D translation with the radiometric render of the same poses, in kelvin."""
