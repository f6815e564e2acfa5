"""What a user describes: scene files, their surfaces, temperatures and air, and edits that return a new scene."""
