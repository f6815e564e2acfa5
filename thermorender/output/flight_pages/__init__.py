"""Pages about a flight: what it will show and cost, before it; a report with map and curves, after it."""
