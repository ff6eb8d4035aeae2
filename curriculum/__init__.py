"""The curriculum: NavACL-Q, its success network and the service that answers task queries."""
