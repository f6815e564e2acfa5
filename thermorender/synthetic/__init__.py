"""How the procedural scenes are made: noise, painting, light, heat, and one layout per kind of landscape."""
