"""Which effects the closed loop has: candidates, competition, removal, rivals, doubt."""
