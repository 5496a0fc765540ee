"""Every figure of the package. Nothing else imports matplotlib, and this only when something is drawn."""
