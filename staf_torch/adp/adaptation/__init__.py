"""Learning while running: what a plant's parameters are, found and used while the plant is controlled."""

from .adaptive_lqr import Adaptation as Adaptation
from .adaptive_lqr import AdaptiveLQR as AdaptiveLQR
from .history_stack import ConcurrentGradient as ConcurrentGradient
from .history_stack import HistoryStack as HistoryStack
from .history_stack import Stack as Stack
from .kalman import Belief as Belief
from .kalman import ExtendedKalman as ExtendedKalman
from .kalman import KalmanFilter as KalmanFilter
from .kalman import Observed as Observed
from .kalman import UnscentedKalman as UnscentedKalman
from .least_squares import Estimate as Estimate
from .least_squares import LeastSquares as LeastSquares
from .measured import ChangingPlant as ChangingPlant
from .measured import Measured as Measured
from .parametric import LinearFamily as LinearFamily
from .parametric import ParametricPlant as ParametricPlant
from .redesign import Doubling as Doubling
from .redesign import riccati_rows as riccati_rows
from .tracker import ConcurrentTracker as ConcurrentTracker
from .tracker import Tracking as Tracking
from .windows import Equation as Equation
from .windows import IntegralWindows as IntegralWindows
from .windows import SlopeWindow as SlopeWindow
from .windows import SlopeWindows as SlopeWindows
from .windows import Window as Window
from .windows import measured_rate as measured_rate
