/* One Bellman sweep, double-buffered, as one would write it by hand: the reference for benchmarks/solving.py.
 *
 *     gcc -O3 -march=native -DACTIONS=3 -shared -fPIC sweep.c -o sweep.so
 */
#include <stdint.h>

static inline __attribute__((always_inline))
void sweep_of(const int32_t *next_states, const float *rewards, double gamma, const double *v, double *out,
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

void sweep(const int32_t *next_states, const float *rewards, double gamma, const double *v, double *out,
           int64_t start, int64_t stop, int64_t num_actions)
{
    sweep_of(next_states, rewards, gamma, v, out, start, stop, num_actions);
}

/* The same where the compiler knows the number of actions, and that arrays do not overlap. */
void sweep_unrolled(const int32_t *restrict next_states, const float *restrict rewards, double gamma,
                    const double *restrict v, double *restrict out, int64_t start, int64_t stop)
{
    sweep_of(next_states, rewards, gamma, v, out, start, stop, ACTIONS);
}

/* Under sticky actions: values (S, ACTIONS) by the action executed before, which is repeated with probability p. */
void sticky_sweep(const int32_t *restrict next_states, const float *restrict rewards, double gamma, double p,
                  const double *restrict v, double *restrict out, int64_t start, int64_t stop)
{
    for (int64_t s = start; s < stop; s++) {
        double best = -1e300, q[ACTIONS];
        for (int a = 0; a < ACTIONS; a++) {
            q[a] = rewards[s * ACTIONS + a] + gamma * v[(int64_t)next_states[s * ACTIONS + a] * ACTIONS + a];
            best = q[a] > best ? q[a] : best;
        }
        for (int a = 0; a < ACTIONS; a++) out[s * ACTIONS + a] = (1 - p) * best + p * q[a];
    }
}
