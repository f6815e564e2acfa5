"""Time from an edit of materials or temperatures to its frame, and the error of previews."""
