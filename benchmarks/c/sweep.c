/* One Bellman sweep, double-buffered, as one would write it by hand: the reference for benchmarks/solving.py. */
#include <stdint.h>

void sweep(const int32_t *next_states, const float *rewards, double gamma, const double *v, double *out,
           int64_t start, int64_t stop, int64_t num_actions)
{
    for (int64_t s = start; s < stop; s++) {
        double best = -1e300;
        for (int64_t a = 0; a < num_actions; a++) {
            double q = rewards[s * num_actions + a] + gamma * v[next_states[s * num_actions + a]];
            best = q > best ? q : best;
        }
        out[s] = best;
    }
}
