// Threads that help with a program, and sleep while there is none: between two calls, and for the last of a call, nobody
// spins. A call begins at once in its own thread and is over when no part of it is left and nobody works on one: a
// helper that comes late finds nothing and is not waited for. Where the system takes the processor from the caller or
// from a helper meanwhile, as beside other busy processes, short calls go alone for a while.

#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <time.h>

namespace {
struct Job {
    void (*work)(void *);  // takes parts until none is left, in any number of threads
    void *data;
    unsigned seats, inside;  // helpers that may come yet, and that are there
    bool away;  // whether somebody was interrupted
    Job *next;
};
pthread_mutex_t door;
pthread_cond_t wanted, left;
Job *jobs;
unsigned helpers;
int64_t alone_until, rest;  // ns
constexpr unsigned is_short = 8;  // a flag that says nothing to OpenMP's function of this form
constexpr int64_t briefly = 20000, interruption = 1000000, shortest = 16000000, longest = 1000000000;  // ns

int64_t clock_of(clockid_t which) {
    timespec now;
    clock_gettime(which, &now);
    return now.tv_sec * int64_t(1000000000) + now.tv_nsec;
}
// A stretch of time, and of it how much the thread had a processor.
struct Watch {
    int64_t time = clock_of(CLOCK_MONOTONIC), own = clock_of(CLOCK_THREAD_CPUTIME_ID);
    bool was_away() const {
        const int64_t worked = clock_of(CLOCK_THREAD_CPUTIME_ID) - own;
        return clock_of(CLOCK_MONOTONIC) - time - worked > interruption;
    }
};

void *help(void *) {
    pthread_mutex_lock(&door);
    for (;;) {
        Job *job = jobs;
        while (job && job->seats == 0) job = job->next;
        if (!job) {
            pthread_cond_wait(&wanted, &door);
            continue;
        }
        --job->seats, ++job->inside;
        pthread_mutex_unlock(&door);
        const Watch watch;
        job->work(job->data);
        const bool away = watch.was_away();
        pthread_mutex_lock(&door);
        job->away |= away;
        if (__atomic_sub_fetch(&job->inside, 1, __ATOMIC_RELEASE) == 0) pthread_cond_broadcast(&left);
    }
}

// Also in the child of a fork, which has none of the threads.
void begin() {
    pthread_mutex_init(&door, nullptr), pthread_cond_init(&wanted, nullptr), pthread_cond_init(&left, nullptr);
    jobs = nullptr, helpers = 0, alone_until = rest = 0;
}
__attribute__((constructor)) void loaded() {
    begin();
    pthread_atfork(nullptr, nullptr, begin);
}

void hire(unsigned count) {
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);  // signals are for the program's own threads
    pthread_t thread;
    for (; helpers < count && pthread_create(&thread, nullptr, help, nullptr) == 0; ++helpers) pthread_detach(thread);
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
}
}  // namespace

extern "C" void staf_threads(void (*work)(void *), void *data, unsigned threads, unsigned flags) {
    Job job{work, data, threads - 1, 0, false, nullptr};
    const bool brief = flags & is_short;
    pthread_mutex_lock(&door);
    if (brief && alone_until && clock_of(CLOCK_MONOTONIC) < alone_until) {
        pthread_mutex_unlock(&door);
        return work(data);
    }
    const Watch watch;  // to wake a helper may take the processor from who wakes it
    if (helpers < job.seats) hire(job.seats);
    job.next = jobs, jobs = &job;
    for (unsigned k = 1; k < threads; ++k) pthread_cond_signal(&wanted);
    pthread_mutex_unlock(&door);
    work(data);
    const bool away = watch.was_away();
    pthread_mutex_lock(&door);
    Job **place = &jobs;
    while (*place != &job) place = &(*place)->next;
    *place = job.next;
    if (job.inside) {
        pthread_mutex_unlock(&door);
        const int64_t end = clock_of(CLOCK_MONOTONIC) + briefly;
        while (__atomic_load_n(&job.inside, __ATOMIC_ACQUIRE) && clock_of(CLOCK_MONOTONIC) < end) {}
        pthread_mutex_lock(&door);  // which the last helper still holds: until then the job is its own
        while (job.inside) pthread_cond_wait(&left, &door);
    }
    if (brief && (away || job.away))
        rest = 2 * rest < shortest ? shortest : 2 * rest < longest ? 2 * rest : longest;
    else if (brief)
        rest = 4 * rest < shortest ? 0 : 3 * rest / 4;
    if (brief) alone_until = rest ? clock_of(CLOCK_MONOTONIC) + rest : 0;
    pthread_mutex_unlock(&door);
}
