"""Adaptive dynamic programming: learn or compute a controller while, or before, it controls."""

from .actor_critic import ActorCritic as ActorCritic
from .adaptation.adaptive_actor_critic import AdaptiveActorCritic as AdaptiveActorCritic
from .adaptation.adaptive_actor_critic import IdentifyingTracker as IdentifyingTracker
from .adaptation.adaptive_actor_critic import LearnedModel as LearnedModel
from .adaptation.adaptive_lqr import Adaptation as Adaptation
from .adaptation.adaptive_lqr import AdaptiveLQR as AdaptiveLQR
from .adaptation.consider import Considered as Considered
from .adaptation.consider import ConsiderFilter as ConsiderFilter
from .adaptation.drift_lqr import DriftAdaptation as DriftAdaptation
from .adaptation.drift_lqr import DriftLQR as DriftLQR
from .adaptation.history_stack import ConcurrentGradient as ConcurrentGradient
from .adaptation.history_stack import ConcurrentLearning as ConcurrentLearning
from .adaptation.history_stack import HistoryStack as HistoryStack
from .adaptation.history_stack import Identified as Identified
from .adaptation.history_stack import Stack as Stack
from .adaptation.kalman import Belief as Belief
from .adaptation.kalman import ExtendedKalman as ExtendedKalman
from .adaptation.kalman import KalmanFilter as KalmanFilter
from .adaptation.kalman import Observed as Observed
from .adaptation.kalman import UnscentedKalman as UnscentedKalman
from .adaptation.least_squares import Estimate as Estimate
from .adaptation.least_squares import LeastSquares as LeastSquares
from .adaptation.measured import ChangingPlant as ChangingPlant
from .adaptation.measured import Measured as Measured
from .adaptation.parametric import LinearFamily as LinearFamily
from .adaptation.parametric import ParametricPlant as ParametricPlant
from .adaptation.redesign import Doubling as Doubling
from .adaptation.redesign import riccati_rows as riccati_rows
from .adaptation.robust_filter import Guarded as Guarded
from .adaptation.robust_filter import RobustFilter as RobustFilter
from .adaptation.stream_drift import DriftEstimate as DriftEstimate
from .adaptation.stream_drift import StreamDrift as StreamDrift
from .adaptation.tracker import ConcurrentTracker as ConcurrentTracker
from .adaptation.tracker import Tracking as Tracking
from .adaptation.windows import Equation as Equation
from .adaptation.windows import IntegralWindows as IntegralWindows
from .adaptation.windows import SlopeWindow as SlopeWindow
from .adaptation.windows import SlopeWindows as SlopeWindows
from .adaptation.windows import Window as Window
from .adaptation.windows import measured_rate as measured_rate
from .avoidance import AvoidanceCost as AvoidanceCost
from .avoidance import AvoidancePlans as AvoidancePlans
from .avoidance import plan_around as plan_around
from .bases import LeadingCoordinates as LeadingCoordinates
from .bases import QuadraticBasis as QuadraticBasis
from .bases import RBFGridBasis as RBFGridBasis
from .bases import StaFValueBasis as StaFValueBasis
from .bases import ValueBasis as ValueBasis
from .bellman import bellman_error as bellman_error
from .bellman import bellman_terms as bellman_terms
from .bellman import hjb_residual as hjb_residual
from .bellman import value_gradient as value_gradient
from .box_filter import BoxFilter as BoxFilter
from .controllers import LQR as LQR
from .controllers import Controller as Controller
from .controllers import ControllerState as ControllerState
from .controllers import Feedback as Feedback
from .controllers import Supervised as Supervised
from .cost import BoundedInputCost as BoundedInputCost
from .cost import Cost as Cost
from .cost import QuadraticCost as QuadraticCost
from .detour_plans import DetourPlans as DetourPlans
from .detours import DetourRollout as DetourRollout
from .energy_shaping import EnergyShaping as EnergyShaping
from .extrapolation import Extrapolation as Extrapolation
from .extrapolation import QuadraturePoints as QuadraturePoints
from .extrapolation import RandomPoints as RandomPoints
from .global_value import GlobalValue as GlobalValue
from .laws import ActorCriticLaw as ActorCriticLaw
from .laws import Frozen as Frozen
from .laws import Gains as Gains
from .laws import Information as Information
from .laws import Published as Published
from .laws import Weights as Weights
from .memory_growth import learn_global_value as learn_global_value
from .near_optimal import NearOptimal as NearOptimal
from .near_optimal import near_optimal as near_optimal
from .path_cost import TrackingCost as TrackingCost
from .path_integral import PathIntegral as PathIntegral
from .plans import Trajectories as Trajectories
from .policy_iteration import PolicyIteration as PolicyIteration
from .receding_horizon import RecedingHorizon as RecedingHorizon
from .rollout import RolloutPolicy as RolloutPolicy
from .safety_filter import Filtered as Filtered
from .safety_filter import SafetyFilter as SafetyFilter
from .sampled_problem import SampledProblem as SampledProblem
from .sampled_rollout import SampledRollout as SampledRollout
from .sampling import HeldStability as HeldStability
from .sampling import held_stability as held_stability
from .shooting import DirectShooting as DirectShooting
from .shooting import Optimum as Optimum
from .shooting import PlanReplay as PlanReplay
from .simulation import LoopResult as LoopResult
from .simulation import simulate as simulate
from .tracking import TwoStateTracking as TwoStateTracking
from .tracking import desired_trajectory as desired_trajectory
from .tracking import tracking_cost as tracking_cost
from .trajectory_optimisation import BoxDDP as BoxDDP

__all__ = [
    "LQR",
    "ActorCritic",
    "ActorCriticLaw",
    "Adaptation",
    "AdaptiveActorCritic",
    "AdaptiveLQR",
    "AvoidanceCost",
    "AvoidancePlans",
    "Belief",
    "BoundedInputCost",
    "BoxDDP",
    "BoxFilter",
    "ChangingPlant",
    "ConcurrentGradient",
    "ConcurrentLearning",
    "ConcurrentTracker",
    "ConsiderFilter",
    "Considered",
    "Controller",
    "ControllerState",
    "Cost",
    "DetourPlans",
    "DetourRollout",
    "DirectShooting",
    "Doubling",
    "DriftAdaptation",
    "DriftEstimate",
    "DriftLQR",
    "EnergyShaping",
    "Equation",
    "Estimate",
    "ExtendedKalman",
    "Extrapolation",
    "Feedback",
    "Filtered",
    "Frozen",
    "Gains",
    "GlobalValue",
    "Guarded",
    "HeldStability",
    "HistoryStack",
    "Identified",
    "IdentifyingTracker",
    "Information",
    "IntegralWindows",
    "KalmanFilter",
    "LeadingCoordinates",
    "LearnedModel",
    "LeastSquares",
    "LinearFamily",
    "LoopResult",
    "Measured",
    "NearOptimal",
    "Observed",
    "Optimum",
    "ParametricPlant",
    "PathIntegral",
    "PlanReplay",
    "PolicyIteration",
    "Published",
    "QuadraticBasis",
    "QuadraticCost",
    "QuadraturePoints",
    "RBFGridBasis",
    "RandomPoints",
    "RecedingHorizon",
    "RobustFilter",
    "RolloutPolicy",
    "SafetyFilter",
    "SampledProblem",
    "SampledRollout",
    "SlopeWindow",
    "SlopeWindows",
    "StaFValueBasis",
    "Stack",
    "StreamDrift",
    "Supervised",
    "Tracking",
    "TrackingCost",
    "Trajectories",
    "TwoStateTracking",
    "UnscentedKalman",
    "ValueBasis",
    "Weights",
    "Window",
    "bellman_error",
    "bellman_terms",
    "desired_trajectory",
    "held_stability",
    "hjb_residual",
    "learn_global_value",
    "measured_rate",
    "near_optimal",
    "plan_around",
    "riccati_rows",
    "simulate",
    "tracking_cost",
    "value_gradient",
]
