//! The MQTT sink: one task that owns the connection, what is to be sent, and what is on its way.
//!
//! Events are queued and acknowledged (QoS 1): those under way when a connection is lost are sent again. Counts and
//! states are read once a tick and sent where they changed; after a reconnection all of them. Tracks and ONVIF frames
//! are the newest of each camera, or nothing.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::stream::FuturesOrdered;
use futures::{FutureExt, StreamExt};
use prometheus::core::Collector;
use prometheus::{IntCounterVec, IntGauge, Opts, Registry};
use rumqttc::{
    AsyncClient, ConnectionError, Event, Incoming, LastWill, MqttOptions, Publish, PublishOptions, QoS,
};
use tokio::sync::mpsc;
use tokio::task::AbortHandle;
use tokio::time::{MissedTickBehavior, interval, timeout, timeout_at};

use super::config::MqttPlan;
use super::home_assistant::Discovery;
use super::onvif;
use super::retained::{Ledger, Snapshots, Topics};
use super::{GRACE, Stop};
use crate::api::Cameras;
use crate::outgoing::{KNOCK, Sparing, backoff};
use crate::publish::{
    self, EventFilter, EventHub, EventListener, Heard, Hub, NumberedEvent, Report, Subscription,
};
use crate::types::CameraId;

/// Events that wait for the broker at most.
const QUEUE: usize = 1000;
/// Events that may be under way without an acknowledgement.
const WINDOW: usize = 32;
/// Messages between this task and the connection's.
const CHANNEL: usize = 256;
/// Longest message that is sent or taken.
const MAX_MESSAGE: usize = 1024 * 1024;
/// Seconds of silence after which the broker is asked whether it is there; it tells the last will after one and a
/// half times as long.
const KEEP_ALIVE: u16 = 15;
/// Longest wait between two attempts to connect.
const LONGEST_WAIT: Duration = Duration::from_secs(30);
/// How long a new connection looks for what an earlier run left retained.
const LOOK_BACK: Duration = Duration::from_secs(5);

const KINDS: [&str; 5] = ["event", "state", "discovery", "tracks", "onvif"];

/// The sink's figures. Clones are the same.
#[derive(Clone)]
pub(super) struct Figures {
    connected: IntGauge,
    waiting: IntGauge,
    messages: IntCounterVec,
}

impl Figures {
    pub(super) fn register(registry: &Registry) -> prometheus::Result<Self> {
        let gauge = |name: &str, help: &str| -> prometheus::Result<IntGauge> {
            let gauge = IntGauge::new(name, help)?;
            registry.register(Box::new(gauge.clone()))?;
            Ok(gauge)
        };
        let help = "Messages to the broker, by kind and by what became of them.";
        let opts = Opts::new("gakp_mqtt_messages_total", help);
        let messages = IntCounterVec::new(opts, &["kind", "outcome"])?;
        registry.register(Box::new(messages.clone()))?;
        let figures = Self {
            connected: gauge("gakp_mqtt_connected", "1 while there is a connection to the MQTT broker.")?,
            waiting: gauge("gakp_mqtt_queue_length", "Events that wait for the MQTT broker.")?,
            messages,
        };
        for kind in KINDS {
            figures.count(kind, "sent", 0);
            figures.count(kind, "dropped", 0);
        }
        Ok(figures)
    }

    /// They are shown no more.
    pub(super) fn unregister(&self, registry: &Registry) {
        let collectors: [Box<dyn Collector>; 3] = [
            Box::new(self.connected.clone()),
            Box::new(self.waiting.clone()),
            Box::new(self.messages.clone()),
        ];
        for collector in collectors {
            // An error means that it is not there.
            let _ = registry.unregister(collector);
        }
    }

    fn count(&self, kind: &str, outcome: &str, messages: u64) {
        self.messages.with_label_values(&[kind, outcome]).inc_by(messages);
    }
}

/// What a sink that has ended leaves to the next.
pub(super) struct Remains {
    listener: EventListener,
    /// Events that were not acknowledged, in order.
    queue: VecDeque<Arc<NumberedEvent>>,
}

impl Remains {
    /// Nothing; it hears what happens from now on.
    pub(super) fn none(events: &EventHub) -> Self {
        Self { listener: events.listen(EventFilter::default()), queue: VecDeque::new() }
    }

    /// Nobody comes to send it: it is counted and told as lost.
    pub(super) fn give_up(mut self, figures: &Figures, reason: &str) {
        let mut lost = self.queue.len() as u64;
        while let Some(heard) = self.listener.try_next() {
            lost += match heard {
                Heard::Event(_) => 1,
                Heard::Missed(missed) => missed,
            };
        }
        figures.waiting.set(0);
        figures.count("event", "dropped", lost);
        if lost > 0 {
            tracing::warn!(lost, reason, "MQTT loses events");
        }
    }
}

/// The MQTT sink, to be run as a task. It goes on with what another has left, and ends with what it leaves itself.
pub(super) fn sink(
    plan: MqttPlan,
    cameras: Arc<dyn Cameras>,
    hub: &Hub,
    remains: Remains,
    figures: Figures,
    stop: Stop,
) -> impl Future<Output = Remains> + Send + use<> {
    let frames = plan.tracks || plan.onvif;
    let subscription = frames.then(|| hub.subscribe(publish::Only::All));
    let Remains { listener, queue } = remains;
    let topics = Topics::new(plan.topic.clone());
    let discovery = plan.discovery.clone().map(Discovery::new);
    tracing::info!(broker = %plan.address, topic = plan.topic, "events go to MQTT");
    let sink = Sink {
        snapshots: Snapshots::new(cameras, topics.clone(), discovery.clone()),
        plan,
        topics,
        discovery,
        classes: hub.classes().clone(),
        figures,
        queue,
        under_way: 0,
        latest: BTreeMap::new(),
        ledger: Ledger::default(),
        session: None,
        failures: 0,
        next_try: Instant::now(),
        losses: Sparing::default(),
        troubles: Sparing::default(),
    };
    sink.run(listener, subscription, stop)
}

struct Sink {
    plan: MqttPlan,
    topics: Topics,
    discovery: Option<Discovery>,
    snapshots: Snapshots,
    classes: Arc<[String]>,
    figures: Figures,
    /// Events that are not acknowledged, in order.
    queue: VecDeque<Arc<NumberedEvent>>,
    /// How many of them, from the front on, are under way.
    under_way: usize,
    /// The newest report of each camera that was not sent yet.
    latest: BTreeMap<CameraId, Arc<Report>>,
    ledger: Ledger,
    session: Option<Session>,
    /// Connections that failed in a row.
    failures: u32,
    next_try: Instant,
    losses: Sparing,
    troubles: Sparing,
}

/// A connection, or an attempt at one. Dropped without a farewell, the broker tells the last will.
struct Session {
    client: AsyncClient,
    polled: mpsc::Receiver<Result<Event, ConnectionError>>,
    driver: AbortHandle,
    /// Whether the broker let us in, and when.
    since: Option<Instant>,
    /// Whether it still looks for what is left over.
    looks_back: bool,
    /// The acknowledgements of the events under way.
    acknowledged: FuturesOrdered<BoxFuture<'static, bool>>,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.driver.abort();
    }
}

/// What a session has to say.
enum Turn {
    Incoming(Incoming),
    /// The oldest event under way was acknowledged.
    Acknowledged,
    Lost(String),
}

impl Session {
    fn open(plan: &MqttPlan, last_will: Option<LastWill>) -> Result<Self, String> {
        let random: String = std::iter::repeat_with(fastrand::alphanumeric).take(16).collect();
        let broker = (plan.address.host.trim_matches(['[', ']']).to_owned(), plan.address.port);
        let mut options = MqttOptions::new(format!("gakp{random}"), broker);
        options.set_keep_alive(KEEP_ALIVE).set_max_packet_size(MAX_MESSAGE, MAX_MESSAGE);
        if let Some(last_will) = last_will {
            options.set_last_will(last_will);
        }
        if let Some(login) = &plan.login {
            options.set_credentials(login.user.clone(), login.password.clone());
        }
        let (address, tls) = (plan.address.clone(), plan.tls.clone());
        options.set_socket_connector(move |_, _| {
            let (address, tls) = (address.clone(), tls.clone());
            async move { address.connect(tls.as_ref()).await }
        });
        let built = AsyncClient::builder(options).capacity(CHANNEL).try_build();
        let (client, mut eventloop) = built.map_err(|e| e.to_string())?;
        let (sender, polled) = mpsc::channel(CHANNEL);
        // A task of its own: a poll that is dropped half-way begins to connect anew.
        let driver = tokio::spawn(async move {
            loop {
                let polled = eventloop.poll().await;
                let over = polled.is_err();
                let told = matches!(polled, Err(_) | Ok(Event::Incoming(_)));
                if told && sender.send(polled).await.is_err() || over {
                    return;
                }
            }
        });
        let acknowledged = FuturesOrdered::new();
        let driver = driver.abort_handle();
        Ok(Self { client, polled, driver, since: None, looks_back: false, acknowledged })
    }

    /// What it has to say next. Cancel safe.
    async fn turn(&mut self) -> Turn {
        tokio::select! {
            polled = self.polled.recv() => match polled {
                Some(Ok(Event::Incoming(packet))) => Turn::Incoming(packet),
                Some(Ok(Event::Outgoing(_))) | None => Turn::Lost("the connection ended".into()),
                Some(Err(error)) => Turn::Lost(error.to_string()),
            },
            Some(acknowledged) = self.acknowledged.next() => match acknowledged {
                true => Turn::Acknowledged,
                false => Turn::Lost("an event was not acknowledged".into()),
            },
        }
    }

    /// Hands a message to the connection; `false` where it has too many already.
    fn publish(&self, topic: String, message: Bytes, options: PublishOptions) -> bool {
        self.client.try_publish(topic, message, options).is_ok()
    }
}

/// Whether the broker lets us in; nothing is published.
///
/// # Errors
/// Why not, in words.
pub(super) async fn knock(plan: &MqttPlan) -> Result<(), String> {
    // Without a last will: a service that runs is not said to be gone when this breaks off.
    let mut session = Session::open(plan, None)?;
    let answer = async {
        loop {
            match session.turn().await {
                Turn::Incoming(Incoming::ConnAck(_)) => return Ok(()),
                Turn::Incoming(_) | Turn::Acknowledged => {}
                Turn::Lost(reason) => return Err(reason),
            }
        }
    };
    let answered = timeout(KNOCK, answer).await;
    let _ = session.client.try_disconnect();
    while let Ok(Turn::Incoming(_) | Turn::Acknowledged) = timeout(GRACE, session.turn()).await {}
    answered.unwrap_or_else(|_| Err(format!("no answer within {} s", KNOCK.as_secs())))
}

/// What the session has to say; nothing, for ever, while there is none.
async fn turn(session: &mut Option<Session>) -> Turn {
    match session {
        Some(session) => session.turn().await,
        None => std::future::pending().await,
    }
}

/// The next report; nothing, for ever, where none are wanted or the hub has closed.
async fn next_report(subscription: &mut Option<Subscription>) -> Option<publish::Event> {
    match subscription {
        Some(subscription) => subscription.next().await,
        None => std::future::pending().await,
    }
}

impl Sink {
    async fn run(
        mut self,
        mut listener: EventListener,
        mut subscription: Option<Subscription>,
        mut stop: Stop,
    ) -> Remains {
        let mut tick = interval(self.plan.every.clamp(Duration::from_millis(100), Duration::from_secs(1)));
        let mut frames = interval(self.plan.tracks_every);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        frames.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = stop.stopped() => break,
                heard = listener.next() => match heard {
                    Some(heard) => self.hear(heard),
                    None => break,
                },
                report = next_report(&mut subscription) => match report {
                    Some(publish::Event::Tracks(report)) => {
                        self.latest.insert(report.tracks.camera.clone(), report);
                    }
                    // Only the newest counts.
                    Some(publish::Event::Gap(_)) => {}
                    None => subscription = None,
                },
                turn = turn(&mut self.session) => self.take(turn),
                _ = tick.tick() => self.tick(),
                _ = frames.tick(), if subscription.is_some() => self.send_frames(),
            }
        }
        while let Some(heard) = listener.try_next() {
            self.hear(heard);
        }
        Remains { listener, queue: self.finish().await }
    }

    fn is_connected(&self) -> bool {
        self.session.as_ref().is_some_and(|session| session.since.is_some())
    }

    fn hear(&mut self, heard: Heard) {
        match heard {
            Heard::Event(event) => {
                if self.queue.len() >= QUEUE {
                    // The oldest that is not under way; there are far fewer under way than fit.
                    self.queue.remove(self.under_way);
                    self.lose(1, "the queue is full");
                }
                self.queue.push_back(event);
                self.send_events();
            }
            Heard::Missed(missed) => self.lose(missed, "they came too fast"),
        }
    }

    fn lose(&mut self, events: u64, reason: &str) {
        self.figures.count("event", "dropped", events);
        if let Some(lost) = self.losses.note(events) {
            tracing::warn!(lost, reason, "MQTT loses events");
        }
    }

    fn take(&mut self, turn: Turn) {
        match turn {
            Turn::Incoming(Incoming::ConnAck(_)) => self.welcome(),
            Turn::Incoming(Incoming::Publish(publish)) => self.read(&publish),
            Turn::Incoming(_) => {}
            Turn::Acknowledged => {
                self.queue.pop_front();
                self.under_way = self.under_way.saturating_sub(1);
                self.figures.count("event", "sent", 1);
                self.send_events();
            }
            Turn::Lost(reason) => self.lost_connection(&reason),
        }
    }

    /// The broker let us in.
    fn welcome(&mut self) {
        let Some(session) = &mut self.session else { return };
        session.since = Some(Instant::now());
        session.looks_back = true;
        self.failures = 0;
        self.figures.connected.set(1);
        tracing::info!(broker = %self.plan.address, "connected to the MQTT broker");
        let online = PublishOptions::at_least_once().retained();
        session.publish(self.topics.status(), Bytes::from_static(b"online"), online);
        let birth = self.discovery.as_ref().map(Discovery::birth);
        for filter in self.topics.leftovers().into_iter().chain(birth) {
            // The channel of a new connection is empty.
            let _ = session.client.try_subscribe(filter, QoS::AtLeastOnce);
        }
        self.ledger.doubt();
        self.send_events();
        self.send_retained();
    }

    fn lost_connection(&mut self, reason: &str) {
        self.session = None;
        self.under_way = 0;
        self.figures.connected.set(0);
        self.failures = self.failures.saturating_add(1);
        self.next_try = Instant::now() + backoff(self.failures, LONGEST_WAIT);
        if let Some(failures) = self.troubles.note(1) {
            let broker = &self.plan.address;
            tracing::warn!(%broker, failures, error = reason, "no connection to the MQTT broker");
        }
    }

    /// A message of the broker: Home Assistant has started, or something is retained from earlier.
    fn read(&mut self, publish: &Publish) {
        let Ok(topic) = std::str::from_utf8(&publish.topic) else { return };
        let birth = self.discovery.as_ref().is_some_and(|discovery| discovery.birth() == topic);
        if birth && !publish.retain && &publish.payload[..] == b"online" {
            self.ledger.doubt();
            self.send_retained();
        }
        if !publish.retain || publish.payload.is_empty() {
            return;
        }
        let Some(subject) = self.topics.subject(topic) else { return };
        self.ledger.suspect(topic.to_owned(), self.plan.every);
        if let Some(discovery) = &self.discovery {
            for (topic, _) in discovery.entities(&self.topics, subject) {
                self.ledger.suspect(topic, self.plan.every);
            }
        }
    }

    fn tick(&mut self) {
        self.figures.waiting.set(self.queue.len() as i64);
        if self.session.is_none() && Instant::now() >= self.next_try {
            let last_will = LastWill::new(self.topics.status(), "offline", QoS::AtLeastOnce, true);
            match Session::open(&self.plan, Some(last_will)) {
                Ok(session) => self.session = Some(session),
                Err(reason) => self.lost_connection(&reason),
            }
        }
        if !self.is_connected() {
            return;
        }
        if let Some(session) = &mut self.session
            && session.looks_back
            && session.since.is_some_and(|since| since.elapsed() > LOOK_BACK)
        {
            session.looks_back = false;
            for filter in self.topics.leftovers() {
                // What is heard in vain costs nothing but the hearing.
                let _ = session.client.try_unsubscribe(filter);
            }
        }
        self.send_events();
        self.send_retained();
    }

    fn send_events(&mut self) {
        let Some(session) = self.session.as_mut().filter(|session| session.since.is_some()) else { return };
        while self.under_way < WINDOW.min(self.queue.len()) {
            let event = &self.queue[self.under_way];
            let topic = self.topics.event(&event.camera);
            let options = PublishOptions::at_least_once();
            let Ok(notice) = session.client.try_publish_tracked(topic, event.json.clone(), options) else {
                return;
            };
            let acknowledged = async move { notice.wait_completion_async().await.is_ok() };
            session.acknowledged.push_back(acknowledged.boxed());
            self.under_way += 1;
        }
    }

    fn send_retained(&mut self) {
        let Some(session) = &self.session else { return };
        let now = self.snapshots.take();
        for (topic, message) in self.ledger.due(&now, self.plan.every) {
            let options = PublishOptions::at_least_once().retained();
            if !session.publish(topic.clone(), message.clone(), options) {
                // The rest with the next tick, what waits longest first.
                return;
            }
            let discovery = self.discovery.as_ref().is_some_and(|discovery| discovery.owns(&topic));
            self.figures.count(if discovery { "discovery" } else { "state" }, "sent", 1);
            self.ledger.sent(topic, message);
        }
    }

    fn send_frames(&mut self) {
        let latest = std::mem::take(&mut self.latest);
        let Some(session) = self.session.as_ref().filter(|session| session.since.is_some()) else { return };
        for (camera, report) in latest {
            let send = |kind: &str, topic: String, message: Bytes| {
                let fits = message.len() < MAX_MESSAGE - 1024;
                let sent = fits && session.publish(topic, message, PublishOptions::at_most_once());
                self.figures.count(kind, if sent { "sent" } else { "dropped" }, 1);
            };
            if self.plan.tracks {
                send("tracks", self.topics.tracks(&camera), report.json());
            }
            if self.plan.onvif {
                send("onvif", self.topics.onvif(&camera), onvif::frame(&report.tracks, &self.classes));
            }
        }
    }

    /// Sends what waits and says goodbye; what is left.
    async fn finish(mut self) -> VecDeque<Arc<NumberedEvent>> {
        let deadline = (Instant::now() + GRACE).into();
        self.send_events();
        while self.is_connected() && self.under_way > 0 {
            let Ok(turn) = timeout_at(deadline, turn(&mut self.session)).await else { break };
            self.take(turn);
        }
        if self.is_connected()
            && let Some(session) = &mut self.session
        {
            let options = PublishOptions::at_least_once().retained();
            let (topic, offline) = (self.topics.status(), Bytes::from_static(b"offline"));
            // A farewell may overtake what is not acknowledged yet.
            if let Ok(notice) = session.client.try_publish_tracked(topic, offline, options) {
                let _ = timeout_at(deadline, notice.wait_completion_async()).await;
            }
            let _ = session.client.try_disconnect();
            loop {
                match timeout_at(deadline, session.turn()).await {
                    Ok(Turn::Incoming(_)) => {}
                    // Late, but it was.
                    Ok(Turn::Acknowledged) => {
                        self.queue.pop_front();
                        self.figures.count("event", "sent", 1);
                    }
                    Ok(Turn::Lost(_)) | Err(_) => break,
                }
            }
        }
        self.figures.connected.set(0);
        self.queue
    }
}
