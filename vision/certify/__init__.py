"""Measure what a recording can resolve, from similar films with known truth and the same analysis."""

from vision.certify.certificate import certify, certify_run
from vision.certify.page import statements, write_certificate
from vision.certify.settings import CertifySettings

__all__ = ["CertifySettings", "certify", "certify_run", "statements", "write_certificate"]
