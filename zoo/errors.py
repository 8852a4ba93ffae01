"""Errors that say what a model, a prediction or a file honestly cannot give."""

__all__ = [
    "BrokenPluginWarning",
    "DamagedRunError",
    "ExtrapolationWarning",
    "FewGroupsWarning",
    "FewerInducingWarning",
    "MovementLengthError",
    "NoDensityError",
    "NoJointSamplesError",
    "NoSpreadError",
    "NoiseDivergenceWarning",
    "NotCalibratedWarning",
    "NotCapableError",
    "NotFittedError",
    "NotRegisteredError",
    "OtherPeopleWarning",
    "OtherQuestionWarning",
    "OtherTrainingError",
    "PosteriorCollapseWarning",
    "RunExistsError",
    "RunLockedError",
    "TooManyItemsError",
    "TrainingError",
    "TrainingWarning",
    "UnanswerableError",
    "UnknownNameError",
    "UnlikeUnitsWarning",
    "WindowsWarning",
]


class UnknownNameError(KeyError, ValueError):
    """A name that nothing is registered under; the message lists the nearest ones."""

    def __str__(self) -> str:
        return str(self.args[0])


class NotRegisteredError(UnknownNameError):
    """A run is of an entry that nobody has registered here."""


class UnanswerableError(Exception):
    """A model has no honest answer to a task, at all or on the data at hand."""


class NotCapableError(UnanswerableError, TypeError):
    """A task that the chosen model has no honest answer to."""


class NotFittedError(RuntimeError):
    """A prediction was asked of a model that has not been trained."""


class NoSpreadError(ValueError):
    """A standard deviation was asked of a deterministic prediction."""


class NoDensityError(ValueError):
    """A density was asked of a prediction that is only known by its quantiles."""


class NoJointSamplesError(ValueError):
    """Joint trajectories were asked of a prediction that only knows its marginals."""


class DamagedRunError(ValueError):
    """A run folder or file that is damaged, foreign, or of an unknown format version."""


class TooManyItemsError(ValueError):
    """More items than an exact method can hold; the message says what it needs and what to take."""


class FewerInducingWarning(UserWarning):
    """A fraction of the items would be more inducing inputs than pay off; fewer were taken."""


class OtherTrainingError(ValueError):
    """A folder holds another training than the one at hand; the message says what differs."""


class RunExistsError(ValueError):
    """A folder holds a run or a begun training, which nothing replaces unasked."""


class RunLockedError(RuntimeError):
    """Another process is writing in the folder."""


class MovementLengthError(UnanswerableError, ValueError):
    """Movements are longer or shorter than those that a model can answer for."""


class TrainingError(RuntimeError):
    """Training failed for good; the message names site and step and what to try."""


class BrokenPluginWarning(UserWarning):
    """An installed package offers a model that cannot join the zoo."""


class FewGroupsWarning(UserWarning):
    """Bands were calibrated on fewer groups than a guarantee of their level needs."""


class NoiseDivergenceWarning(UserWarning):
    """Two sparse approximations of one Gaussian process disagree on the noise."""


class TrainingWarning(UserWarning):
    """Training met a loss or gradient that is not finite and went back to its last good state."""


class PosteriorCollapseWarning(UserWarning):
    """Latent dimensions carry nothing: their posterior is the prior."""


class UnlikeUnitsWarning(UserWarning):
    """Channels of several units are scaled by one number."""


class OtherQuestionWarning(UserWarning):
    """Bands are asked for a question that they were not calibrated for."""


class OtherPeopleWarning(UserWarning):
    """Bands are asked for people who were not among those that they were calibrated on."""


class NotCalibratedWarning(UserWarning):
    """A task has no answer on the calibration data, so that its bands stay as they are."""


class WindowsWarning(UserWarning):
    """Windows are given to a model of whole movements, or whole movements to one of windows."""


class ExtrapolationWarning(UserWarning):
    """A goal lies far outside of all that the training movements showed."""
