# SPDX-License-Identifier: MIT
"""Results to keep and show: failure folders, archives of cases, JSON, JUnit, pages."""
