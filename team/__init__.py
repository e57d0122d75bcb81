"""What the team shares (estimation, wire, recording) and the member itself (robot)."""
