"""The judgement: evidence in, verdict and findings out. No I/O, no state."""

from __future__ import annotations

from calib.evidence import Evidence
from calib.findings import Finding, State, Verdict
from calib.limits import DOME_LIMIT_PERCENT, Z95, percent, reference_decides
from calib.rules import HELD_RULES, RULES

#: Flags that say which geometry is missing; more photos cure them even where the block is faulty.
GEOMETRY = frozenset({"convergent-share", "focal-sigma"})
#: Without these no calibration is trusted, whether there is a reference or not.
ALWAYS_DECISIVE = (
    "focal-sigma",
    "predicted-dome",
    "cross-validation",
    "model-sensitivity",
    "alignment",
)
WITH_REFERENCE = ("focal-drift", "equifinal-deviation", *ALWAYS_DECISIVE)
#: Without a reference the network has to prove itself.
ALONE = ("convergent-share", *ALWAYS_DECISIVE)
#: Nothing from outside confirms a calibration without a reference, so this stays open then.
UNCONFIRMED = (*ALONE, "focal-drift")
#: Which flag makes the headline, the most telling first.
_TELLING = (
    "focal-sigma",
    "convergent-share",
    "focal-drift",
    "predicted-dome",
    "equifinal-deviation",
    "equifinal-line",
    "model-sensitivity",
    "cross-validation",
    "coverage",
)


def judge(evidence: Evidence) -> tuple[Verdict, str, tuple[Finding, ...]]:
    """Verdict, headline and one finding for every rule, in the order of the rules.

    * REFLY: a rule is flagged that more photos can cure. Every rule but alignment is such a one:
      a wrong focal length, distortion or dome, halves or models that disagree, and thin coverage
      all come from weak geometry.
    * A flag of alignment (a broken block, geotags that contradict it) is not cured by flying, and
      casts doubt on whatever else was flagged: CANNOT TELL, unless the geometry is missing too
      (convergent-share or focal-sigma flagged), which is then said beside the fault.
    * TRUST: nothing is flagged and every decisive rule passes. With a reference that is itself
      known well enough for 0.1 %, those are ``WITH_REFERENCE``; with one of another body of the
      model, those are ``ALONE`` and the limit on the sigma of f is stricter. Without a reference
      nothing from outside confirms the calibration: CANNOT TELL at best, ready to become one.
    * CANNOT TELL: nothing is flagged, but a decisive rule is unknown.

    ``equifinal-line`` and ``opposite-signs`` never block TRUST by being unknown: where the method
    does not apply, the deviation itself is still compared. A small residual passes nothing but
    its own part of alignment.
    """
    findings = tuple(rule(evidence) for rule in RULES)
    by_rule = {finding.rule: finding for finding in findings}
    flagged = {finding.rule for finding in findings if finding.state is State.FLAG}
    if evidence.f_ref_px is None:
        decisive: tuple[str, ...] = UNCONFIRMED
    else:
        decisive = WITH_REFERENCE if reference_decides(evidence) else ALONE
    faulty = "alignment" in flagged
    if flagged & GEOMETRY or (flagged and not faulty):
        first = next(rule for rule in _TELLING if rule in flagged)
        headline = by_rule[first].message
        if faulty:
            headline += f" Also, {_lower(by_rule['alignment'].message)}"
        return Verdict.REFLY, headline, findings
    if faulty:
        return Verdict.CANNOT_TELL, by_rule["alignment"].message, findings
    open_rules = [rule for rule in decisive if by_rule[rule].state is not State.PASS]
    if open_rules == ["focal-drift"] and evidence.f_ref_px is None:
        return Verdict.CANNOT_TELL, _unconfirmed(evidence), findings
    if open_rules:
        return Verdict.CANNOT_TELL, by_rule[open_rules[0]].message, findings
    return Verdict.TRUST, _trusted(evidence), findings


def judge_held(evidence: Evidence) -> tuple[Verdict, str, tuple[Finding, ...]]:
    """The same for a survey whose lens was held at a reference.

    * REFLY: the photos contradict the reference, or the block bends. Convergent photos cure it: with them
      this lens, as it is now, can be calibrated.
    * TRUST: nothing speaks against the reference, and the photos or their positions exclude a dome.
    * CANNOT TELL: nothing speaks against it, but a dome could not have been seen; or the block is broken.
    """
    findings = tuple(rule(evidence) for rule in HELD_RULES)
    by_rule = {finding.rule: finding for finding in findings}
    if by_rule["alignment"].state is State.FLAG:
        return Verdict.CANNOT_TELL, by_rule["alignment"].message, findings
    for rule in ("reference-fit", "radial-residuals", "predicted-dome", "position-dome"):
        if by_rule[rule].state is State.FLAG:
            return Verdict.REFLY, by_rule[rule].message, findings
    domes = (by_rule["predicted-dome"], by_rule["position-dome"])
    if by_rule["reference-fit"].state is State.PASS and any(d.state is State.PASS for d in domes):
        return (
            Verdict.TRUST,
            f"Nothing speaks against reference {evidence.reference_name}, at which the lens was held, and "
            f"the photos would have shown a dome of more than {DOME_LIMIT_PERCENT:g} % of the height.",
            findings,
        )
    room = evidence.sigma_dome_percent
    unseen = "a dome" if room is None else f"a dome of up to {percent(Z95 * room)} of the height"
    return (
        Verdict.CANNOT_TELL,
        f"Nothing speaks against reference {evidence.reference_name}, at which the lens was held, but "
        f"the photos could not have shown {unseen}: the survey is as good as the reference, and no "
        "better proven.",
        findings,
    )


def _trusted(e: Evidence) -> str:
    known = f"the focal length is known to {percent(100 * e.sigma_f_px / e.f_px)} (1 sigma)"
    if reference_decides(e) and e.f_ref_px is not None:
        drift = percent(100 * abs(e.f_px - e.f_ref_px) / e.f_ref_px)
        return (
            f"The calibration can be trusted: it agrees with reference {e.reference_name} "
            f"({drift} in the focal length), and {known}."
        )
    return f"The calibration can be trusted on the strength of the photos alone: {known}."


def _unconfirmed(e: Evidence) -> str:
    note = f" {e.reference_note}" if e.reference_note else ""
    return (
        f"The photos alone speak for this calibration (the focal length is known to "
        f"{percent(100 * e.sigma_f_px / e.f_px)}), but no reference confirms it.{note} "
        "Keep it as one with --save-reference."
    )


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
