// The rules and the table of `Bank`: see bank_rules.py.

#pragma once

#include "_trackers.hpp"

constexpr int C = CAPACITY, near = NEIGHBOURS, sides = 2, groups = 3, locals = groups * lanes, carried = lanes;
constexpr int members = locals + carried + 2 * lanes + 2, clocks = 3;  // quadratics, trackers, the linear model, the last value
constexpr int unknowns = n + 1, groups_of_members = 11, blends = 4, knots = 33;
constexpr double least = 1e-30;  // of a variance

struct Rules {  // see bank.py
    double rates[sides * 3 + 2];       // of the exponents: nearest by width, latest by width, the two fades
    double noise[locals];              // variances, in units of a member's amplitude
    double width[locals], fade[locals];  // which of the eight exponentials a member takes; fade -1 for none
    double discounts[clocks], discount, share, drop, heavy, likelihood;
    double members_rate, error_rate, linear_forgetting, linear_prior, recent, floor, margin, far, outlying;
    double rescaled[9], scaling, carried_forgetting[carried], carried_ratio, carried_slack2;
    double quadratic_forgetting[lanes], quadratic_prior[lanes], pace, correction_prior, correction_forgetting;
    double correction_most, correction_discount, correction_share, least, doubts[clocks], doubt;
    double doubtful, doubtful_outside, outside, rare, doubted_rate, settled;
    double squares_discount, squares_rate, squares_share, own_rate, best_rate, largest, uncalibrated, searched_at;
    double map_step, map_prior, map_forgetting;
    TrackerRules trackers;
    Functions functions;
};

struct Stream {  // the row of a stream in the table of bank.py
    double clock, count, far, skipped, learned, time;
    double last_x[n], last_y[K], asked[n], answered;
    double waiting, trust, doubted, waiting_time, waiting_lapse, waiting_x[n], waiting_y[K];
    double center[n + K], spread[n + K];
    double covariance[unknowns][unknowns], linear[K][unknowns];
    double filters[sizeof(Filter) / sizeof(double)];
    Quadratics quadratics;
    double quadratic_error[K][lanes];
    Trackers trackers;
    Row tracker_rate, tracker_noise, tracker_forgetting;  // in place of those of the rules, once they are learned
    double metric[n][n];
    double weights[K][clocks][members], clock_weights[K][clocks], excess[K][members], usual[K][members];
    double squares[K][members];
    double error[K], pace[K], own[K], best[K], low[K], high[K], calibration[K];
    double correction_covariance[K][groups_of_members][groups_of_members], correction[K][groups_of_members];
    double away[K][groups_of_members], corrected[K][blends];
    double map[K][2][knots];  // corrections, and what is known of them
    double means[K][members], variances[K][members], mixed[K][clocks], mixed_variance[K][clocks];
    double blend[K][blends], straight[K], mean[K], variance[K];
    double x[C][n], y[C][K], when[C], order[C], gap[C];
    double unlearned;  // time that has passed in samples that were skipped
};
