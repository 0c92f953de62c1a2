//! A process's place in the shared memory of a run.

use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder, NodeCreationFailure};
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::{
    AttributeVerifier, LogLevel, MessagingPattern, SemanticString, Service, ServiceName, SignalHandlingMode,
    ipc, set_log_level,
};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern as StaticPattern;

use crate::abandoned::without_waiting_for_the_lost;
use crate::leftovers::clear_the_way;
use crate::memory::{NEEDED, check_free, keep_to_ourselves, reserve};
use crate::shared_link::MOST_BORROWED;
use crate::{Channel, LinkError, Payload, RunId, SharedPublisher, SharedSubscriber};

/// Places for processes of a run on a channel.
pub const MAX_PROCESSES: usize = 16;
/// Publishers that are gone of which a subscriber still holds messages: one gives out one message and looks at another. Every look for a
/// message goes through the room for them, so that iceoryx2's 128 cost a tenth of a microsecond each time.
const MAX_LOST_PUBLISHERS: usize = 2;
/// The attribute of a channel that says which joints it is about.
pub const JOINT_SET: &str = "joint_set_hash";
/// A peer that is just being started, ended or cleaned up after a kill makes opening fail for a moment; on a machine whose cores are all
/// taken, for seconds. Longer than it takes until a half-made file counts as lost.
const CONNECT_PATIENCE: Duration = Duration::from_secs(20);
/// A place that is taken by a living process stays taken, and memory that cannot be had is not there a moment later.
const PORT_PATIENCE: Duration = Duration::from_millis(1500);
const CONNECT_PAUSE: Duration = Duration::from_millis(20);
/// How long iceoryx2 itself waits for a peer that is just making the same channel.
const CREATION_PATIENCE: Duration = Duration::from_millis(100);

/// Connects a process to the channels of one run, over shared memory (iceoryx2).
///
/// Publishers and subscribers stay on the thread that made them, and keep working after the node is dropped. What a killed process left
/// is cleaned up by the next one that enters the same run.
#[derive(Debug)]
pub struct RunNode {
    node: Node<ipc::Service>,
    run: RunId,
    joint_set_hash: u64,
}

impl RunNode {
    /// Enters a run. A process that loads no robot, like the supervisor, passes 0 for `joint_set_hash` and uses heartbeats only.
    ///
    /// # Errors
    /// [`LinkError::NoSharedMemory`], [`LinkError::NotPrivate`], [`LinkError::NoRuntimeFolder`].
    pub fn open(run: RunId, joint_set_hash: u64) -> Result<Self, LinkError> {
        set_log_level(LogLevel::Fatal); // errors come back as values; standard error belongs to the process
        let config = config_of(run)?;
        clear_the_way(run)?;
        check_free(NEEDED)?;
        let create = || {
            let node = NodeBuilder::new().config(&config).signal_handling_mode(SignalHandlingMode::Disabled);
            node.create::<ipc::Service>()
        };
        let node = without_waiting_for_the_lost(run, || {
            let begin = Instant::now();
            loop {
                match create() {
                    Err(NodeCreationFailure::InternalError) if begin.elapsed() < CONNECT_PATIENCE => {
                        sleep(CONNECT_PAUSE);
                    }
                    made => break made,
                }
            }
        });
        let root = run.root_path()?;
        let node = node.map_err(|source| LinkError::NoSharedMemory { run, root, source })?;
        keep_to_ourselves(run);
        Ok(Self { node, run, joint_set_hash })
    }

    /// The sending end of a channel. It does not matter which end is made first.
    ///
    /// # Errors
    /// [`LinkError::JointSetMismatch`], [`LinkError::IncompatiblePayload`], [`LinkError::Occupied`] when the channel has a living
    /// publisher, [`LinkError::SharedMemoryFull`], [`LinkError::Connect`].
    pub fn publisher<T: Payload>(&self, channel: Channel) -> Result<SharedPublisher<T>, LinkError> {
        without_waiting_for_the_lost(self.run, || {
            let service = self.service::<T>(channel)?;
            let publisher = self.insist(PORT_PATIENCE, || match service.publisher_builder().create() {
                Ok(port) => Attempt::Done(SharedPublisher::new(port, channel.name())),
                Err(PublisherCreateError::ExceedsMaxSupportedPublishers) => {
                    Attempt::TryAgain(self.occupied(channel, "publisher"))
                }
                Err(other) => Attempt::TryAgain(self.refused(channel, &other)),
            })?;
            reserve(self.run)?;
            Ok(publisher)
        })
    }

    /// The receiving end of a channel. It does not matter which end is made first.
    ///
    /// # Errors
    /// As [`Self::publisher`], with at most eight subscribers on a channel.
    pub fn subscriber<T: Payload>(&self, channel: Channel) -> Result<SharedSubscriber<T>, LinkError> {
        self.subscriber_with_buffer(channel, 1)
    }

    /// A receiving end that keeps as many messages as the channel has room for: read it by [`SharedSubscriber::receive_next`].
    ///
    /// # Errors
    /// As [`Self::subscriber`].
    pub fn recorder<T: Payload>(&self, channel: Channel) -> Result<SharedSubscriber<T>, LinkError> {
        self.subscriber_with_buffer(channel, channel.buffer_size())
    }

    fn subscriber_with_buffer<T: Payload>(
        &self,
        channel: Channel,
        buffer_size: usize,
    ) -> Result<SharedSubscriber<T>, LinkError> {
        without_waiting_for_the_lost(self.run, || {
            let service = self.service::<T>(channel)?;
            let create = || service.subscriber_builder().buffer_size(buffer_size).create();
            self.insist(PORT_PATIENCE, || match create() {
                Ok(port) => Attempt::Done(SharedSubscriber::new(port, channel.name())),
                Err(SubscriberCreateError::ExceedsMaxSupportedSubscribers) => {
                    Attempt::TryAgain(self.occupied(channel, "subscriber"))
                }
                Err(other) => Attempt::TryAgain(self.refused(channel, &other)),
            })
        })
    }

    /// The run this process is in.
    pub fn run(&self) -> RunId {
        self.run
    }

    /// Opens a channel, or makes it if we are first, with latest-value settings.
    fn service<T: Payload>(&self, channel: Channel) -> Result<PortFactory<ipc::Service, T, ()>, LinkError> {
        let name = self.service_name(channel)?;
        let required = self.required_attributes(channel)?;
        self.insist(CONNECT_PATIENCE, || {
            let opened = self
                .node
                .service_builder(&name)
                .publish_subscribe::<T>()
                .enable_safe_overflow(true)
                .history_size(1)
                .subscriber_max_buffer_size(channel.buffer_size())
                .subscriber_max_borrowed_samples(MOST_BORROWED)
                .max_publishers(1)
                .max_subscribers(channel.max_subscribers())
                .max_nodes(MAX_PROCESSES)
                .open_or_create_with_attributes(&required);
            match opened {
                Ok(service) => Attempt::Done(service),
                Err(error) if is_transient(error) => Attempt::TryAgain(self.refused(channel, &error)),
                Err(error) => Attempt::Fail(self.explain::<T>(channel, &name, error)),
            }
        })
    }

    /// Tries until it is done, fails for good, or has been tried for long enough; between attempts, what dead processes left is removed.
    fn insist<R>(&self, patience: Duration, attempt: impl Fn() -> Attempt<R>) -> Result<R, LinkError> {
        let begin = Instant::now();
        loop {
            match attempt() {
                Attempt::Done(result) => return Ok(result),
                Attempt::Fail(error) => return Err(error),
                Attempt::TryAgain(error) if begin.elapsed() > patience => return Err(error),
                Attempt::TryAgain(_) => {}
            }
            self.node.try_cleanup_dead_nodes();
            sleep(CONNECT_PAUSE);
        }
    }

    fn service_name(&self, channel: Channel) -> Result<ServiceName, LinkError> {
        let name = self.run.service_name(channel);
        ServiceName::new(&name).map_err(|error| self.refused(channel, &error))
    }

    /// What both ends must agree on besides the message type.
    fn required_attributes(&self, channel: Channel) -> Result<AttributeVerifier, LinkError> {
        let attributes = AttributeVerifier::new();
        if !channel.needs_same_joint_set() {
            return Ok(attributes);
        }
        let key = JOINT_SET.try_into().map_err(|error| self.refused(channel, &error))?;
        let value = format!("{:016x}", self.joint_set_hash);
        let value = value.as_str().try_into().map_err(|error| self.refused(channel, &error))?;
        attributes.require(&key, &value).map_err(|error| self.refused(channel, &error))
    }

    /// Turns a refusal into an error that says what the peer has.
    fn explain<T: Payload>(
        &self,
        channel: Channel,
        name: &ServiceName,
        error: OpenOrCreateError,
    ) -> LinkError {
        use OpenOrCreateError::PublishSubscribeOpenError as Open;
        match error {
            Open(OpenError::IncompatibleAttributes) => match self.peers_joint_set(name) {
                Some(found) => {
                    let (channel, ours) = (channel.name(), self.joint_set_hash);
                    LinkError::JointSetMismatch { channel, found, ours }
                }
                None => self.refused(channel, &error),
            },
            Open(OpenError::IncompatibleTypes) => {
                let found = self.peers_payload(name).unwrap_or_else(|| "another type".to_owned());
                LinkError::IncompatiblePayload { channel: channel.name(), found, ours: T::NAME }
            }
            _ => self.refused(channel, &error),
        }
    }

    fn peers_joint_set(&self, name: &ServiceName) -> Option<u64> {
        let key = JOINT_SET.try_into().ok()?;
        let peer =
            ipc::Service::details(name, self.node.config(), MessagingPattern::PublishSubscribe).ok()??;
        let value = peer.static_details.attributes().key_value(&key, 0)?.to_string();
        u64::from_str_radix(&value, 16).ok()
    }

    fn peers_payload(&self, name: &ServiceName) -> Option<String> {
        let peer =
            ipc::Service::details(name, self.node.config(), MessagingPattern::PublishSubscribe).ok()??;
        match peer.static_details.messaging_pattern() {
            StaticPattern::PublishSubscribe(details) => {
                Some(details.message_type_details().payload.type_name().to_string())
            }
            _ => None,
        }
    }

    fn refused(&self, channel: Channel, reason: &dyn std::fmt::Debug) -> LinkError {
        LinkError::Connect { run: self.run, channel: channel.name(), reason: format!("{reason:?}") }
    }

    fn occupied(&self, channel: Channel, end: &'static str) -> LinkError {
        LinkError::Occupied { run: self.run, channel: channel.name(), end }
    }
}

/// How an attempt to connect ended.
enum Attempt<R> {
    Done(R),
    /// It may work in a moment.
    TryAgain(LinkError),
    Fail(LinkError),
}

/// Whether trying again in a moment can help.
fn is_transient(error: OpenOrCreateError) -> bool {
    use OpenOrCreateError::{PublishSubscribeCreateError as Create, PublishSubscribeOpenError as Open};
    matches!(
        error,
        OpenOrCreateError::SystemInFlux
            | Open(
                OpenError::DoesNotExist
                    | OpenError::IsMarkedForDestruction
                    | OpenError::HangsInCreation
                    | OpenError::ServiceInCorruptedState
                    | OpenError::ExceedsMaxNumberOfNodes
            )
            | Create(
                CreateError::AlreadyExists
                    | CreateError::IsBeingCreatedByAnotherInstance
                    | CreateError::HangsInCreation
                    | CreateError::ServiceInCorruptedState
            )
    )
}

/// The settings that keep a run to itself: its own prefix of every name and its own folder.
pub(crate) fn config_of(run: RunId) -> Result<Config, LinkError> {
    let mut config = Config::default();
    let unusable = |what: &Path| LinkError::Connect {
        run,
        channel: "all",
        reason: format!("{} cannot be part of a name in shared memory", what.display()),
    };
    let (prefix, root) = (run.prefix(), run.root_path()?);
    let prefix_name = iceoryx2::prelude::FileName::new(prefix.as_bytes());
    config.global.prefix = prefix_name.map_err(|_| unusable(prefix.as_ref()))?;
    let root_name = iceoryx2::prelude::Path::new(root.as_os_str().as_encoded_bytes());
    config.global.creation_timeout = CREATION_PATIENCE;
    config.defaults.publish_subscribe.subscriber_expired_connection_buffer = MAX_LOST_PUBLISHERS;
    config.global.node.cleanup_dead_nodes_on_destruction = false; // ending must not wait for anybody
    config.global.set_root_path(&root_name.map_err(|_| unusable(&root))?);
    Ok(config)
}
