//! Of zenoh's threads.

/// Where zenoh reads how many threads it starts.
const VARIABLE: &str = "ZENOH_RUNTIME";
/// What receives runs where what sends does: in the one thread of that.
const ONE_THREAD: &str = "(rx: (handover: tx))";

/// Whether one of `endpoints` is a `tls/` one, for which [`use_one_thread`] is meant.
pub fn needs_one_thread<'a>(endpoints: impl IntoIterator<Item = &'a String>) -> bool {
    endpoints.into_iter().any(|endpoint| endpoint.starts_with("tls/"))
}

/// Lets zenoh receive and send in one thread for as long as this process lives, unless the environment says how many
/// already.
///
/// A `tls/` link of zenoh 1.10.2 is one TLS connection that the task that receives and the task that sends both change,
/// without a lock (`LinkUnicastTls::get_mut_socket`). In two threads that is a data race, and processes were seen to abort
/// from it. In one thread the tasks take turns.
///
/// # Safety
/// This process must have no other thread yet: it changes the environment.
pub unsafe fn use_one_thread() {
    if std::env::var_os(VARIABLE).is_none() {
        // SAFETY: nobody else can read or write the environment, as the caller promises.
        unsafe { std::env::set_var(VARIABLE, ONE_THREAD) };
    }
}

/// Whether [`use_one_thread`], or somebody in its place, was there.
pub(super) fn is_chosen() -> bool {
    std::env::var_os(VARIABLE).is_some()
}
