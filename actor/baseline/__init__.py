"""Classical controllers, examined like policies (section 4.4)."""
