"""Pictures of scenes: read, drawn, written as sheets and clips."""
